"""Join the manifests of the shards of a set of pairs: `python -m torchrefract.merge out=DIR`.

The rows of all shards are sorted into one manifest.jsonl, repeated rows and rows of missing files are dropped, and the
card of the set and its table pairs.parquet are written anew. The status is 1 if a pair is missing, or if the options of
shards differ.

Options:
    out=DIR                 folder of the pairs, required
    verify=true             compare all files with their checksums

Example:
    python -m torchrefract.merge out=pairs verify=true
"""

from torchrefract.cli.entry import command

main = command("merge", __doc__, "generation:merge", has_sweeps=False)

if __name__ == "__main__":
    main()
