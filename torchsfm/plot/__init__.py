"""What does it look like? Figures with matplotlib and an interactive 3D page."""

from torchsfm.plot.framing import up_direction
from torchsfm.plot.page import write_page

__all__ = ["up_direction", "write_page"]
