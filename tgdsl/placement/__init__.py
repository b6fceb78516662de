"""Where taxels go on a robot's links."""
