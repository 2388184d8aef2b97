"""Questions that tell apart hypotheses of what people believe incorrectly."""
