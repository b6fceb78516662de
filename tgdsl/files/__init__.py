"""Files: paths, atomic writes, and the cache of baked results."""
