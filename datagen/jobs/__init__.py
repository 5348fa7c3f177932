"""Jobs of `submit` and `resume`: on this machine or on a cluster."""
