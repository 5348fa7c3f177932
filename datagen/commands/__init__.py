"""The verbs of the command line: one file per verb, or per two that belong together."""
