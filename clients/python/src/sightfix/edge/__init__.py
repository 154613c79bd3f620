"""The edge client: turns video into boxes with tracker ids and streams them to a server.

Needs the extra `edge`; the command is `sightfix-edge`. Frames are arrays of (height, width, 3) bytes, blue first.
"""
