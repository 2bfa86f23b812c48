"""The Darknet family: networks from the published ``.cfg``, with ``.weights`` in and out."""
