"""What the HTTP servers of this machine share: addresses, tokens, requests."""
