"""The user's verbs: planning, resuming, showing and auditing runs, on the command line."""

__version__ = "0.1.0"
