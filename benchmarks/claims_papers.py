"""List the claims of both papers: what they say, what they publish and where, and the evidence on it.

The published figures are those of the papers; a claim is measured by what `claims_evidence.py` reads.
"""

from claims import GROUPS, OWN
from claims_evidence import (
    Claim,
    Evidence,
    of_jobs,
    of_loops,
    of_rows,
    of_runs,
    of_scenes,
    of_scores,
    of_ways,
)
from paired_comparison import Figure

ATE = Figure("ate_m", "ATE", "cm", -1, 100.0, digits=3)
PSNR = Figure("psnr_db", "PSNR", "dB", +1)
DEPTH = Figure("depth_l1_m", "depth L1", "cm", -1, 100.0)
RANK = Figure("spearman", "Spearman", "", +1, digits=3)
SPLATS = Figure("splats", "splats", "k", -1, 1e-3, digits=1)
CPU = Figure("cpu_s", "CPU time of a frame", "ms", -1, 1000.0, digits=0)
CHAMFER = Figure("splats_chamfer_m", "Chamfer", "cm", -1, 100.0)
ERROR = Figure("registration_m", "error", "cm", -1, 100.0, digits=3)
LOCALISED = Figure("localised_m", "error", "cm", -1, 100.0)
STEPS = Figure("steps", "steps", "", -1, digits=1)
HOPS = Figure("rank", "Spearman", "", +1, digits=2)
PRECISION = Figure("average_precision", "average precision", "%", +1, 100.0)
LOST = Figure("lost", "lost frames", "", -1, digits=1)
NLL = Figure("nll_full", "NLL", "nats", -1)
TO_SURFACE = Figure("splats_accuracy_m", "splats to surface", "cm", -1, 100.0)
FLOATERS = Figure("floaters", "floaters", "%", -1, 100.0)
HELD_OUT_PSNR = Figure("held_out_psnr_db", "PSNR", "dB", +1)
HELD_OUT_DEPTH = Figure("held_out_depth_l1_m", "depth L1", "cm", -1, 100.0)


def in_claims(group: str, figure: Figure, changed: str, against: str | None = None) -> Evidence:
    """Return evidence from claims.py: of the paper's own settings if they were measured."""
    own = OWN.get(group, "")
    own = own if own and {changed, against} <= {*GROUPS[own].variants} else ""
    preset = GROUPS.get(group, GROUPS["submaps"]).preset
    return Evidence("claims", of_rows(*filter(None, (own, group))), figure, changed, against, preset, own)


def in_weights(group: str, figure: Figure, changed: str, against: str) -> Evidence:
    """Return evidence from weights.py."""
    return Evidence("weights", of_rows(group), figure, changed, against, "sigma")


def in_ablation(changed: str, against: str) -> Evidence:
    """Return evidence on the ATE from ablation.py."""
    return Evidence("ablation", of_runs, ATE, changed, against, "varsplat-fast")


def in_systems(figure: Figure, changed: str, against: str) -> Evidence:
    """Return evidence from systems.py: one preset against another."""
    return Evidence("systems", of_jobs, figure, changed, against, changed)


def in_scenes(figure: Figure, without: str) -> Evidence:
    """Return evidence from consistency.py, which leaves out parts of the method."""
    return Evidence("consistency", of_scenes, figure, "full", without, "cgslam-fast")


NO_NUMBER = "–"
NO_DATA = "`sigmasplat bench table {}`, where the data is"
VARSPLAT = (
    Claim(
        "V ranks the errors of colour", NO_NUMBER, "more",
        Evidence("uncertainty", of_scores("color", "all pixels"), RANK, "V", None, "sigma"),
        "V and squared error, held-back views",
    ),
    Claim(
        "a learned σ² makes V rank them better than the scatter of colours alone", NO_NUMBER, "more",
        in_systems(RANK, "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "V in tracking lowers the ATE", "ablation, ScanNet: 8.20 → 7.63 cm", "less",
        in_claims("varsplat", ATE, "V in tracking", "no weights"),
    ),
    Claim(
        "V in the alignment of images lowers the ATE (`varsplat-fast`)", "as above", "less",
        in_ablation("+tracking", "none"),
    ),
    Claim(
        "V in the alignment of images lowers the ATE (`sigma`)", "as above", "less",
        in_weights("path", ATE, "default", "tracking: no weights"),
    ),
    Claim(
        "the loop gate by σ² lowers the ATE", "ablation, ScanNet: 7.63 → 7.49 cm", "less",
        in_ablation("+loop", "+tracking"),
    ),
    Claim(
        "the loop gate orders candidates better", NO_NUMBER, "more",
        in_weights("gate", PRECISION, "V", "no weights"),
    ),
    Claim(
        "V in registration lowers the ATE", "ablation, ScanNet: 7.49 → 6.53 cm", "less",
        in_ablation("+registration", "+loop"),
    ),
    Claim(
        "V in registration makes registrations more accurate", NO_NUMBER, "less",
        in_weights("registration", ERROR, "V", "no weights"),
    ),
    Claim(
        "all weights together lower the ATE", "ablation, ScanNet: 8.20 → 6.53 cm", "less",
        in_weights("path", ATE, "default", "no weights at all"),
    ),
    Claim(
        "loop closure lowers the ATE (LoopSplat's part)", NO_NUMBER, "less",
        Evidence("loops", of_loops, ATE, "loops", "no loops", "sigma"), "rooms with drifting depth",
    ),
    Claim(
        "VarSplat's ATE is lower than LoopSplat's",
        "ATE: Replica 0.23 (0.26), TUM 3.20 (3.33), ScanNet++ 1.69 (2.05) cm", "less",
        in_systems(ATE, "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "tracking is more robust: fewer frames are lost", NO_NUMBER, "less",
        in_weights("path", LOST, "default", "tracking: no weights"),
    ),
    Claim(
        "accumulated tracking uncertainty shows where submaps should end", "a rule without a formula", "more",
        None, "not reproduced by V (commit 780358915); the rule is gone",
    ),
    Claim(
        "ours: the accumulated covariance of the pose shows where submaps should end", "not in the paper", "more",
        in_claims("hops", HOPS, "covariance"),
    ),
    Claim(
        "the likelihood does not make views worse", NO_NUMBER, "no worse",
        in_claims("varsplat", PSNR, "no weights", "no likelihood"),
    ),
    Claim(
        "views are at least as good as LoopSplat's", "Replica: PSNR 37.15 dB, depth L1 0.50 cm", "no worse",
        in_systems(HELD_OUT_PSNR, "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "depth of views is at least as good as LoopSplat's", "as above", "no worse",
        in_systems(HELD_OUT_DEPTH, "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "variance costs time", "runtime, Replica room0: mapping 1.9 (1.2), tracking 2.0 (1.8) s per frame", "more",
        in_claims("varsplat", CPU, "V in tracking", "no likelihood"),
    ),
    Claim(
        "registration averages colour errors over values (3HW), not pixels (HW)", "a formula", "less",
        in_claims("registration", ERROR, "mean over values", "mean over pixels"),
    ),
    Claim(
        "localisation may stop on a plateau (ours: 10 steps)", "a stop at small steps", "no worse",
        in_claims("localisation", LOCALISED, "window 10", "no stop"),
    ),
    Claim(
        "a stop on a plateau saves steps", "as above", "less",
        in_claims("localisation", STEPS, "window 10", "no stop"),
    ),
    Claim(
        "a stop after one step without progress does no harm", "not in the paper", "no worse",
        in_claims("localisation", LOCALISED, "window 1", "no stop"),
    ),
    Claim(
        "ours: merging and refinement by σ² improves views", "not used, a named limitation", "more",
        in_weights("final", PSNR, "V", "no weights"),
    ),
    Claim(
        "ATE on Replica, TUM, ScanNet, ScanNet++", "0.23, 3.20, 6.5, 1.69 cm", "less", None,
        NO_DATA.format("varsplat-replica"),
    ),
    Claim(
        "views and surface on Replica, novel views on ScanNet++",
        "PSNR 37.15 dB, SSIM 0.986, LPIPS 0.109, F1 90.2 %; novel views 21.33 dB", "more", None,
        NO_DATA.format("varsplat-scannetpp"),
    ),
)  # fmt: skip
CGSLAM = (
    Claim(
        "U ranks the errors of depth", NO_NUMBER, "more",
        Evidence("uncertainty", of_scores("depth", "covered pixels"), RANK, "U", None, "sigma"),
        "the same of depth; U about the rendered depth",
    ),
    Claim(
        "alignment and variance bring splats to the surface", "ablation, Replica: Chamfer 4.79 → 3.85 cm", "less",
        in_scenes(TO_SURFACE, "without both"),
    ),
    Claim(
        "alignment alone brings splats to the surface", "4.74 → 3.85 cm", "less",
        in_scenes(TO_SURFACE, "without alignment"),
    ),
    Claim(
        "variance alone brings splats to the surface", "4.57 → 3.85 cm", "less",
        in_scenes(TO_SURFACE, "without variance"),
    ),
    Claim(
        "alignment and variance lower the ATE", "ablation, Replica: 0.33 → 0.26 cm", "less",
        in_scenes(ATE, "without both"),
    ),
    Claim(
        "isotropy lowers the ATE", "Replica: office3 0.72 → 0.31 cm", "less",
        in_scenes(ATE, "without isotropy"),
    ),
    Claim("isotropy leaves fewer floaters", NO_NUMBER, "less", in_scenes(FLOATERS, "without isotropy")),
    Claim(
        "pruning by the uncertainty of primitives removes floaters", NO_NUMBER, "less",
        in_scenes(FLOATERS, "without primitive uncertainty"),
    ),
    Claim(
        "alignment and variance bring splats to the surface, by descent", "Chamfer 4.79 → 3.85 cm", "less",
        in_claims("cgslam", CHAMFER, "full", "without both"),
    ),
    Claim(
        "alignment alone brings splats to the surface, by descent", "4.74 → 3.85 cm", "less",
        in_claims("cgslam", CHAMFER, "full", "without alignment"),
    ),
    Claim(
        "variance alone brings splats to the surface, by descent", "4.57 → 3.85 cm", "less",
        in_claims("cgslam", CHAMFER, "full", "without variance"),
    ),
    Claim(
        "alignment and variance lower the ATE, by descent", "ablation, Replica: 0.33 → 0.26 cm", "less",
        in_claims("cgslam", ATE, "full", "without both"),
    ),
    Claim(
        "alignment alone lowers the ATE", "0.28 → 0.26 cm", "less",
        in_claims("cgslam", ATE, "full", "without alignment"),
    ),
    Claim(
        "variance alone lowers the ATE", "0.30 → 0.26 cm", "less",
        in_claims("cgslam", ATE, "full", "without variance"),
    ),
    Claim(
        "isotropy lowers the ATE and prevents failure", "office3 0.72 → 0.31 cm; office4 fails without it", "less",
        in_claims("cgslam", ATE, "full", "without isotropy"),
    ),
    Claim(
        "pruning by the uncertainty of primitives lowers the ATE", "a curve for room1", "less",
        in_claims("cgslam", ATE, "full", "without fading"),
    ),
    Claim(
        "the same pruning improves depth in `sigma`", NO_NUMBER, "less",
        in_weights("path", DEPTH, "default", "pruning: no fading"),
    ),
    Claim(
        "U in the loss of `sigma` lowers the ATE", NO_NUMBER, "less",
        in_weights("path", ATE, "default", "mapping: no U"),
    ),
    Claim(
        "tracking by pixels or splats of low U lowers the ATE", "overview", "less",
        in_weights("path", ATE, "tracking: depth by U", "default"), "ours: U against V",
    ),
    Claim(
        "the complete pose gradient is more accurate than the released code's", NO_NUMBER, "less",
        Evidence("pose-gradient", of_ways, ATE, "+ covariance", "mean + depth", "varsplat-fast"),
    ),
    Claim(
        "the complete gradient of the pose is more accurate (`cgslam-fast`)", NO_NUMBER, "less",
        in_claims("cgslam", ATE, "full", "simplified gradient"),
        "without the path through the 2D covariance",
    ),
    Claim(
        "the light form needs less time", "runtime, office0: 8.5 → 15.4 frames/s", "less",
        in_claims("cgslam", CPU, "full", "double width"), "160 against 320 pixels of width",
    ),
    Claim(
        "the light form needs fewer splats", "231.66 → 56.50 MB", "less",
        in_claims("cgslam", SPLATS, "full", "double width"),
    ),
    Claim(
        "the light form has a higher ATE", "Replica: 0.27 → 0.42 cm", "more",
        in_claims("cgslam", ATE, "full", "double width"),
    ),
    Claim(
        "few splats suffice: `cgslam-fast` has fewer than `varsplat-fast`", NO_NUMBER, "less",
        in_systems(SPLATS, "cgslam-fast", "varsplat-fast"),
    ),
    Claim(
        "NetVLAD chooses the window faster than overlap", "stated", "less", None,
        "`sigmasplat download netvlad` gets its weights",
    ),
    Claim("ATE on Replica, TUM, ScanNet", "0.27, 4.0, 8.08 cm", "less", None, NO_DATA.format("cgslam-replica")),
    Claim(
        "views and surface on Replica", "PSNR 37.17 dB, SSIM 0.987, LPIPS 0.060; accuracy 1.01, completion 2.84 cm",
        "more", None, NO_DATA.format("cgslam-replica"),
    ),
)  # fmt: skip
PAPERS = {"VarSplat": VARSPLAT, "CG-SLAM": CGSLAM}
