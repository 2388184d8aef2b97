"""Many jobs as one sweep: planned, run on any launcher, resumed, watched, mirrored in MLflow."""
