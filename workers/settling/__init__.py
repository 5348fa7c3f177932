"""Physics until rest. SETTLERS is the registry; each engine lives in one file."""
