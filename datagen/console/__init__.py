"""The terminal: tables, JSON, command lines and shared options."""
