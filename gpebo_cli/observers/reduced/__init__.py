"""The GPEBO observer for any E(t) of constant rank: one formula (paper, Proposition 1, D1, D5).

With P = E⁺E, Q = I − P, Π = I − E E⁺, the algebraic equations and the outputs are

    𝒜 x + g_y + G θ = 0,      𝒜 = [Π A; C],  g_y = [Π B u; −y],  G = [Π F; 0].

If 𝒜 Q has the rank of Q (Assumption 1, impulse observability), v = Q x follows from w = P x:

    x = X_w w + x_y + X_θ θ,     X_w = I − K 𝒜,  x_y = −K g_y,  X_θ = −K G,   K = (𝒜 Q)⁺
    ẇ = A_0 w + b_0 + D_0 θ,     A_0 = Λ X_w,  b_0 = Λ x_y + E⁺B u,  D_0 = Λ X_θ + E⁺F

with Λ = E⁺A + Ṗ and Ṗ = S + Sᵀ, S = E⁺ Ė Q. The dynamic extension integrates ξ_a, ξ_b, Φ with
this A_0, so that w = ξ_a + ξ_b θ − Φ e₀. The algebraic equations from which v has been eliminated
are the regression:

    Y = R (𝒜 ξ_a + g_y),   ψ = [ −R (𝒜 ξ_b + G),  R 𝒜 Φ ],   R = I − 𝒜 Q K,   Y = ψ η.

With weights w of the outputs, rows of C and y are multiplied by √w: K and R become the weighted
elimination K = (W^½ 𝒜 Q)⁺ W^½ and the weighted residual, whose squares ψᵀψ and ψᵀY hold. An output
with noise of variance σ² is worth w = 1/σ².

Only known functions of time are differentiated (Ė), and no signal is. For E = diag(I, 0) this is
the paper's observer exactly, except that R keeps all rows of the residual: the paper keeps the
last r, which loses everything in its own circuit (``regression: paper`` shows it).
"""
