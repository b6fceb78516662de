"""A report of many small results: a table in the terminal, one HTML page with plots, CSV and JSON."""
