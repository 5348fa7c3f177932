"""What people see: progress of a command, styles, figures, and the frame of HTML pages."""
