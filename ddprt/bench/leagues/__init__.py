"""Methods against the baseline, fairly: `ddprt bench --leagues` and `--splits`.

Enters: a configuration and its dataset. Leaves: leagues.jsonl and splits.jsonl, who wins under which budget and by how much,
a page. Never enters: held-out light before a method's settings are chosen.
"""
