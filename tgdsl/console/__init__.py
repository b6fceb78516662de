"""What users see in a console: tables, and notes on long work."""
