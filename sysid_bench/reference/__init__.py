"""Reference of everything that a user types, made from the code: Markdown, a page per subject."""
