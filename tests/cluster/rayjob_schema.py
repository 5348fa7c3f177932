"""The fields of a RayJob that this project's manifest may use, as KubeRay's reference documents them.

KubeRay's own schema is a part of its operator and of no Python package, so this one was written by hand
from the published reference of ray.io/v1 (KubeRay 1.5 to 1.7) and of Kubernetes' pods. It is strict: what
it does not name is refused, so a misspelt field is found. What it cannot find is a field that it names and
a later KubeRay drops; `kubectl apply --dry-run=server` on a cluster asks KubeRay itself.
"""

from __future__ import annotations

from typing import Any

Schema = dict[str, Any]


def record(required: tuple[str, ...] = (), **properties: Schema) -> Schema:
    """An object of these fields alone."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def list_of(items: Schema) -> Schema:
    return {"type": "array", "items": items, "minItems": 1}


def words_of(*words: str) -> Schema:
    return {"enum": list(words)}


TEXT: Schema = {"type": "string", "minLength": 1}
FLAG: Schema = {"type": "boolean"}
COUNT: Schema = {"type": "integer", "minimum": 0}
PORT: Schema = {"type": "integer", "minimum": 1, "maximum": 65535}
NAME: Schema = {"type": "string", "pattern": "^[a-z0-9]([-a-z0-9]*[a-z0-9])?$", "maxLength": 63}
QUANTITY: Schema = {"type": "string", "pattern": r"^[0-9]+(\.[0-9]+)?(m|[KMGT]i?)?$"}
TEXTS: Schema = {"type": "object", "additionalProperties": {"type": "string"}}
RESOURCES = {
    "type": "object",
    "propertyNames": {"enum": ["cpu", "memory", "ephemeral-storage"]},
    "additionalProperties": QUANTITY,
}

CONTAINER = record(
    ("name", "image", "resources", "securityContext"),
    name=NAME,
    image=TEXT,
    imagePullPolicy=words_of("Always", "IfNotPresent", "Never"),
    securityContext=record(
        allowPrivilegeEscalation=FLAG,
        capabilities=record(add=list_of(TEXT), drop=list_of(TEXT)),
        privileged=FLAG,
        readOnlyRootFilesystem=FLAG,
    ),
    env=list_of(record(("name",), name=TEXT, value={"type": "string"})),
    envFrom=list_of(record(secretRef=record(("name",), name=NAME, optional=FLAG))),
    ports=list_of(
        record(
            ("containerPort",), name=NAME, containerPort={"type": "integer", "minimum": 1, "maximum": 65535}
        )
    ),
    resources=record(("requests", "limits"), requests=RESOURCES, limits=RESOURCES),
    volumeMounts=list_of(record(("name", "mountPath"), name=NAME, mountPath=TEXT, readOnly=FLAG)),
)
POD = record(
    ("containers", "securityContext"),
    automountServiceAccountToken=FLAG,
    terminationGracePeriodSeconds=COUNT,
    nodeSelector=TEXTS,
    securityContext=record(
        runAsNonRoot=FLAG,
        runAsUser=COUNT,
        runAsGroup=COUNT,
        fsGroup=COUNT,
        seccompProfile=record(("type",), type=words_of("RuntimeDefault", "Localhost", "Unconfined")),
    ),
    containers=list_of(CONTAINER),
    volumes=list_of(
        record(("name",), name=NAME, emptyDir=record(medium=words_of("Memory"), sizeLimit=QUANTITY))
    ),
)
TEMPLATE = record(("spec",), spec=POD)
CLUSTER = record(
    ("rayVersion", "authOptions", "headGroupSpec", "workerGroupSpecs"),
    rayVersion=TEXT,
    authOptions=record(("mode",), mode=words_of("token", "disabled"), secretName=NAME),
    enableInTreeAutoscaling=FLAG,
    headGroupSpec=record(
        ("rayStartParams", "template"),
        serviceType=words_of("ClusterIP", "NodePort", "LoadBalancer"),
        enableIngress=FLAG,
        rayStartParams=TEXTS,
        template=TEMPLATE,
    ),
    workerGroupSpecs=list_of(
        record(
            ("groupName", "replicas", "minReplicas", "maxReplicas", "rayStartParams", "template"),
            groupName=NAME,
            replicas=COUNT,
            minReplicas=COUNT,
            maxReplicas=COUNT,
            rayStartParams=TEXTS,
            template=TEMPLATE,
        )
    ),
)
RAY_JOB = record(
    ("apiVersion", "kind", "metadata", "spec"),
    apiVersion=words_of("ray.io/v1"),
    kind=words_of("RayJob"),
    metadata=record(("name",), name=NAME, namespace=NAME, labels=TEXTS, annotations=TEXTS),
    spec=record(
        ("entrypoint", "rayClusterSpec"),
        entrypoint=TEXT,
        runtimeEnvYAML=TEXT,
        backoffLimit=COUNT,
        activeDeadlineSeconds=COUNT,
        submissionMode=words_of("K8sJobMode", "HTTPMode", "SidecarMode", "InteractiveMode"),
        shutdownAfterJobFinishes=FLAG,
        ttlSecondsAfterFinished=COUNT,
        suspend=FLAG,
        rayClusterSpec=CLUSTER,
    ),
)
