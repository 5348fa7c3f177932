"""From options, files and stored scenes to a specification, a layout and a manifest."""
