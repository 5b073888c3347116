"""Pictures, HTML pages and diagnostic reports."""
