"""RGB-D frames of a scene. RENDERERS is the registry; each engine lives in one file."""
