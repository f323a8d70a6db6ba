"""Slow reference of rotary embedding, attention and the transformer: query by query, without padding."""

import math

import torch


def rotate_reference(x, angle):
    """Rotate the pairs (i, i + half) of x [channel] by angle [half]."""
    half = len(x) // 2
    out = x.clone()
    for i in range(half):
        c, s = math.cos(angle[i]), math.sin(angle[i])
        out[i] = x[i] * c - x[i + half] * s
        out[i + half] = x[i + half] * c + x[i] * s
    return out


def attend_reference(Q, K, V, scale):
    """One sample and head: Q [query channel]. Returns the output and the attention each key received."""
    out, received = torch.zeros(len(Q), V.shape[1]), torch.zeros(len(K))
    for q in range(len(Q)):
        if not len(K):
            continue
        scores = torch.stack([(Q[q] * K[k]).sum() * scale for k in range(len(K))])
        odds = (scores - scores.max()).exp()
        weights = odds / odds.sum()
        received = received + weights
        out[q] = (weights[:, None] * V).sum(0)
    return out, received


def transformer_reference(net, tokens, uvs, context_tokens, context_uvs, top_k):
    """One sample, section 6 as written: P [query dim], R [key dim], their coordinates [. 3]."""
    config = net.config
    heads, head_dim = config.heads, config.dim // config.heads
    scale = 1 / math.sqrt(config.dim)
    angle = lambda uvs: (uvs[:, None] * net.frequencies).sum(0)  # noqa: E731
    P = tokens
    kept = list(range(len(context_tokens)))
    for number in range(config.groups * config.blocks):
        if number % config.blocks == 0:
            kept = list(range(len(context_tokens)))
        block = net.blocks[number]
        KV = (context_tokens @ net.keys_values.weight.T + net.keys_values.bias).unflatten(
            1, (-1, 2, config.dim)
        )
        K, V = KV[:, number, 0], KV[:, number, 1]
        Q = block.query(block.norm_query(P))
        outs, total = [], torch.zeros(len(context_tokens))
        for h in range(heads):
            own = slice(h * head_dim, (h + 1) * head_dim)
            q, k, v = Q[:, own].clone(), K[kept][:, own].clone(), V[kept][:, own].clone()
            if config.rope:
                q = torch.stack([rotate_reference(x, angle(u)) for x, u in zip(q, uvs, strict=True)])
                k = torch.stack(
                    [rotate_reference(x, angle(context_uvs[i])) for x, i in zip(k, kept, strict=True)]
                )
            out, received = attend_reference(q, k, v, scale)
            outs.append(out)
            total[kept] += received.detach()
        P = P + torch.cat(outs, 1)
        P = P + block.ffn(block.norm_ffn(P))
        if number % config.blocks == 0 and top_k is not None:
            kept = sorted(sorted(kept, key=lambda i: -float(total[i].detach()))[:top_k])
    return P
