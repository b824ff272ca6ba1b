"""Examine the installation: sigmasplat doctor."""

OK, UNHEALTHY = 0, 1


def doctor() -> int:
    """Examine the installation: versions, processor, kernels, self-test.

    exit code 1 if something is wrong; example: sigmasplat doctor
    """
    from sigmasplat.checks.installation import Finding, examine, verdict

    findings: list[Finding] = []
    for finding in examine():
        findings.append(finding)
        mark = {True: "ok  ", False: "FAIL", None: "    "}[finding.ok]
        print(f"{mark} {finding.name:<16}{finding.value}", flush=True)
    healthy, sentence = verdict(findings)
    print(sentence)
    return OK if healthy else UNHEALTHY
