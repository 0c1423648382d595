"""What is counted and measured while a run goes on, for its report and its checks."""
