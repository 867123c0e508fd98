"""Draw effects on a picture, a video or a folder of frames: `python -m torchrefract.preview image.jpg`."""

from torchrefract.cli.command import command, picture_as_option
from torchrefract.cli.preview import preview

main = command("preview", preview, prepare=picture_as_option)

if __name__ == "__main__":
    main()
