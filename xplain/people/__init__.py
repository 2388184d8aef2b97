"""Web pages for people: the user study, and the collection of labels, on one engine."""
