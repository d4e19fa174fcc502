"""What a training run leaves behind, each file a link of one chain; read and checked by whoever looks at a run.

    runs/quickstart/
        manifest.json             config, spec, versions, command
        manifests/000000.json     those before it: a resumed run has a new one, which names the digest of the one before
        trajectories/000001.jsonl one file per generation round
        updates.jsonl             one receipt per generation round: what the update used
        memory.json               with `scope: run`: the memories that tasks carry on (`agentspec.carry`)
        metrics.jsonl             what the trainer logged
        evaluations.jsonl         what evaluation while training found (`eval_strategy: steps`)
        seal.json                 written when the run ends: its digest is the head of the chain

A receipt holds the digests of its round's trajectory files, of the memory after it, of the manifest and of the receipt
before it; the seal those of all these files, and of each of their lines. Whoever keeps the head can tell any later
edit. Without it, an edit is told as long as its author does not compute every digest after it anew.
"""
