"""The page that shows a policy driving live: its content, its server, and video files."""
