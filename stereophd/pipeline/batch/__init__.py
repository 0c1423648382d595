"""Many recordings through one command: a folder for each, a summary, and faults that stop nothing else."""
