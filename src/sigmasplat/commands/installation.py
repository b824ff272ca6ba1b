"""Command `sigmasplat doctor`: check the installation."""

OK, UNHEALTHY = 0, 1


def doctor() -> int:
    """Check the installation: versions, processor, kernels, self-test.

    exit code 1 if a check fails; example: sigmasplat doctor
    """
    from sigmasplat.plugins.checks.installation import Finding, check_installation, verdict

    findings: list[Finding] = []
    for finding in check_installation():
        findings.append(finding)
        mark = {True: "ok  ", False: "FAIL", None: "    "}[finding.ok]
        print(f"{mark} {finding.name:<16}{finding.value}", flush=True)
    healthy, sentence = verdict(findings)
    print(sentence)
    return OK if healthy else UNHEALTHY
