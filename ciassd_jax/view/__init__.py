"""Views of point clouds and boxes: `bev` and `overlay` draw matplotlib figures, `html` writes one page in 3D.

`view_frame` holds the record that a page shows and builds it from frames and scenes; `sources` reads it from files.
The libraries of the extra `viz` are imported when a function needs them.
"""
