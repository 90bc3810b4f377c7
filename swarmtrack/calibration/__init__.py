"""What looks at images to find out how a camera is made, and how it sits on its drone."""
