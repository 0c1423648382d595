"""Settings estimated from a log: what `init` writes, and the value of ``motion.acceleration_std: estimate``."""
