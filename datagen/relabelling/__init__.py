"""Labels by another rule over the files of a run."""
