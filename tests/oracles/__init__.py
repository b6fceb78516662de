"""What the package computes against closed forms of mechanics, heat and statistics: one file per field."""
