"""People named end to end, from photographs on disk."""
