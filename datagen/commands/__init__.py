"""The verbs of the command line: a file is a verb, or two that belong together."""
