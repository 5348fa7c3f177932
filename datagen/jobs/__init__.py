"""Jobs: what `submit`, `resume` and `extend` let run, here, on a cluster or detached, and its records."""
