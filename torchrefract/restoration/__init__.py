"""Train networks that restore degraded frames, score them, apply them to pictures and videos, and export them."""
