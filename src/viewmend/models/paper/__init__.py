"""The paper's transformer. Read config, patches, tokenizer, transformer, context, patch_transformer."""
