"""From an adapter to what runs elsewhere: merged folders, exported graphs, a page to try it in."""
