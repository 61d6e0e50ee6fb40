"""What a run leaves behind: CSV tables, ``summary.json`` and figures.

The only package that knows of matplotlib, and none of its modules imports it before a figure is
drawn. ``folder.write_run`` writes a whole run, ``figures.draw`` yields single figures.
"""
