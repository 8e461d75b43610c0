"""A page in the browser: pick and place by mouse, watch, keep what was done; see docs/play.md.

The page is served on the loopback interface alone. What it needs beyond the package is the extra
`page`, which is imported when it is used.
"""
