"""What is there, and what has been sensed of it."""
