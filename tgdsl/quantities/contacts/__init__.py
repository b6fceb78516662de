"""Contacts: the solver's, on the bodies that carry a sensor."""
