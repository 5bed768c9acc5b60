"""Models joined to one."""
