"""What `nics` can do, a module for each command."""
