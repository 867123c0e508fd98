"""Labels that follow a flow. Coordinates are in px; pixel centers have integer coordinates."""
