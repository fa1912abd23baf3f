"""Pictures of scenes and detections: `bev` and `overlay` (matplotlib figures), `html` (one page in 3D).

`frames` has the record that a page shows and makes it from frames, scenes and results; `sources` reads it from files.
"""
