"""Generated views: what a group of views needs, and the fan-out of groups over workers."""
