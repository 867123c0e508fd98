"""Remove lens distortion from pictures or videos: `python -m torchrefract.rectify input=DIR camera=camera.yaml`."""

from torchrefract.cli.calibration import rectify
from torchrefract.cli.command import command

main = command("rectify", rectify)

if __name__ == "__main__":
    main()
