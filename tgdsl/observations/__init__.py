"""What a policy reads, made of readings and of joints."""
