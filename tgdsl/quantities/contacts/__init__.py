"""The solver's contacts on the bodies that carry a sensor."""
