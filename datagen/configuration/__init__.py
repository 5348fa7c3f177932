"""Make the specification, layout and manifest of a run from options, files and stored scenes."""
