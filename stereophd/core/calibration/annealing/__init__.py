"""The annealed method: tasks, fits, starts and what they agree on."""
