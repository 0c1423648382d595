"""From configurations and logs to results, and the files that they are kept in."""
