"""The user study: a web page that a lab can put in front of participants."""

from xplain.people.study.flow import Study as FLOW

__all__ = ["FLOW"]
