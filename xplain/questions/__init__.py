"""What to ask people: hypotheses of what they hold wrong, and questions that tell them apart."""
