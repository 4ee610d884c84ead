"""What the commands print and save: readings, results and posteriors, as lines, as a picture, as files; a stack's status."""
