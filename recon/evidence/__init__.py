"""How far a volume can be trusted: error bars, and the numbers of its parts with theirs."""
