"""Jobs of `submit` and `resume`: on this machine, on a cluster or detached."""
