"""Dreams on a torch device."""
