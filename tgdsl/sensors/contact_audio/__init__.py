"""Contact audio: what bodies sound like that are struck and scraped."""
