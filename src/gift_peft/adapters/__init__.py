"""LoRA adapters in PEFT's own format: recipes for each base, the folder that holds one, its scale."""
