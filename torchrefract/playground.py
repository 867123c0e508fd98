"""Degrade a picture on a page in the browser: `python -m torchrefract.playground`.

The page shows a picture of yours, or a rendered road, before and after a scene or an effect, with a slider for each
parameter, the maps, the plan and the time. It copies the Python code and the YAML of what it shows. It works without a
network, and this machine alone can open it. Ctrl-C stops it.

Options:
    port=7860               of the address http://127.0.0.1:7860
    browser=true            open the page in the browser
    max_side=1920           px; larger pictures are reduced, so that the page answers quickly

Examples:
    python -m torchrefract.playground
    python -m torchrefract.playground port=7870 browser=false
"""

from torchrefract.cli.entry import command

main = command("playground", __doc__, "playground:playground", has_sweeps=False)

if __name__ == "__main__":
    main()
