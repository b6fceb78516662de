"""`tgdsl layout`: where taxels sit, proposed or written down, one command per file."""
