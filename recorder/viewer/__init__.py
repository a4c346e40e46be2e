"""What viewers such as Foxglove show of a log: live server, layout, annotations, video, report."""
