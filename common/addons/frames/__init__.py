"""Pictures that a run or a view sends while it happens."""
