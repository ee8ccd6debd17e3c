"""The browser tool `gift-peft studio` (extra `studio`): masks of groups, surface targets, base beside adapter."""
