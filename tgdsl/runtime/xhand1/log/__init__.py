"""What a hand said, recorded and played again."""
