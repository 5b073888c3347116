"""The page that shows a policy driving, live: what it shows, its server, and files of it."""
