"""Robot formats, import and export: MJCF, URDF, USD."""
