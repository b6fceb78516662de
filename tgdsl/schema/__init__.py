"""The schema of documents: models, YAML with line numbers, error messages, JSON Schema."""
