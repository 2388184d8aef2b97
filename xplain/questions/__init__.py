"""Questions that separate hypotheses of what people believe incorrectly."""
