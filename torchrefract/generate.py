"""Write pairs to disk: `python -m torchrefract.generate scene=paper_weather source=DIR out=DIR license="CC BY 4.0"`."""

from torchrefract.cli.command import command, quote_option
from torchrefract.cli.generation import generate

main = command("generate", generate, prepare=quote_option("license"))

if __name__ == "__main__":
    main()
