"""Display of logs in viewers such as Foxglove: live server, layout, annotations, video, report."""
