"""Settings that follow from a log: what `init` writes, and what ``motion.acceleration_std: estimate`` stands for."""
