"""The method over HTTP, for other people's pages and robots: the next messages, and the next
question."""
