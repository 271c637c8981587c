"""User files: lookup by name, bounded reading, validation, and safe replacement."""
