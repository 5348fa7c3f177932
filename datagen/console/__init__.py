"""The terminal: tables, JSON, progress, numbers among the options."""
