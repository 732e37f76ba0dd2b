"""What is seen and reported of the tissue: stereo images, points and the tool."""
