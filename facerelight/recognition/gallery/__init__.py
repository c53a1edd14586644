"""People enrolled from photographs, and others' photographs identified among them: templates, search, calibration,
command."""
