"""A robot that is reached over rosbridge: what it says, where it is told to go, and the advice that it is given."""
