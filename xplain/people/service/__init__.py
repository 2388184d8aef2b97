"""The method over HTTP, for pages and robots of others: what to say now, and what to ask next."""
