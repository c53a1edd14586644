"""A portrait to light in a browser: what a session knows, packed into one page that needs neither server nor network.

``contents`` says what the page has to know, ``dome`` compresses what depends on where a lamp stands, ``packing`` writes
arrays, ``page`` puts the file together. ``web/`` is the page: ``light``, ``shade``, ``ratio`` and ``colour`` are the
rooms of the same names in Python, in the same order and with the same constants.
"""
