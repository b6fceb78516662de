"""The package's results against closed forms of mechanics, heat and statistics: one file per field."""
