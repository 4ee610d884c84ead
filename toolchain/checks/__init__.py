"""What is wrong with a machine, said before anything runs."""
