"""Several pixels, poses and expressions at a time (chapter 5): what people look like under views, and how views
relate."""
