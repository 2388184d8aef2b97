"""The method over HTTP, for other people's pages and robots: the service decides the next messages
and the next question."""
