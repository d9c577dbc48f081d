"""Commands as functions: each takes a request or a few arguments and returns a frozen result."""
