"""Collecting labels: a web page on which people say which of a robot's steps make sense."""
