"""The user study: web pages for a lab's participants."""

from xplain.people.study.flow import Study as FLOW

__all__ = ["FLOW"]
