"""Labels that follow the image. Coordinates are px, and pixel centers are whole numbers."""
