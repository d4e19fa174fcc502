"""What the methods with many calls per decision share: one tree, one UCT, one place for budgets."""
