"""The paper's transformer. Read config, patches, tokenizer, attention, transformer, decoder, patch_transformer."""
