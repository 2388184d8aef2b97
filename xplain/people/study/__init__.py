"""The user study: a web page that a lab can put in front of participants."""
