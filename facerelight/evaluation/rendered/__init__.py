"""Protocols on rendered heads that the statistics have not seen, whose shape, skin and light are known."""
