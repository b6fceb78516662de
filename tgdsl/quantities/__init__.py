"""What kinds ask of a scene, one folder each."""
