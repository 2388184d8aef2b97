"""Collection of labels: a web page on which people say which of a robot's steps make sense."""

from xplain.people.collect.flow import Collection as FLOW

__all__ = ["FLOW"]
