"""Live view: what viewers get of a running daemon, and the layout file for Foxglove and Lichtblick.

In comes the loop's shared memory; out go the log's topics, thinned out, on a websocket (extra `live`), and a layout.
May import `daemon.shared` and `daemon.recording`; entry points: `keeper` (supervisor), `process`, `layout` (`jtq layout`).
"""
