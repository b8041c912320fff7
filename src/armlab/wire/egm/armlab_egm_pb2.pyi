from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class EgmHeader(_message.Message):
    __slots__ = ("seqno", "tm", "mtype")
    SEQNO_FIELD_NUMBER: _ClassVar[int]
    TM_FIELD_NUMBER: _ClassVar[int]
    MTYPE_FIELD_NUMBER: _ClassVar[int]
    seqno: int
    tm: int
    mtype: int
    def __init__(self, seqno: _Optional[int] = ..., tm: _Optional[int] = ..., mtype: _Optional[int] = ...) -> None: ...

class EgmCartesian(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class EgmEuler(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class EgmQuaternion(_message.Message):
    __slots__ = ("u0", "u1", "u2", "u3")
    U0_FIELD_NUMBER: _ClassVar[int]
    U1_FIELD_NUMBER: _ClassVar[int]
    U2_FIELD_NUMBER: _ClassVar[int]
    U3_FIELD_NUMBER: _ClassVar[int]
    u0: float
    u1: float
    u2: float
    u3: float
    def __init__(self, u0: _Optional[float] = ..., u1: _Optional[float] = ..., u2: _Optional[float] = ..., u3: _Optional[float] = ...) -> None: ...

class EgmClock(_message.Message):
    __slots__ = ("sec", "usec")
    SEC_FIELD_NUMBER: _ClassVar[int]
    USEC_FIELD_NUMBER: _ClassVar[int]
    sec: int
    usec: int
    def __init__(self, sec: _Optional[int] = ..., usec: _Optional[int] = ...) -> None: ...

class EgmTimestamp(_message.Message):
    __slots__ = ("sec", "nsec")
    SEC_FIELD_NUMBER: _ClassVar[int]
    NSEC_FIELD_NUMBER: _ClassVar[int]
    sec: int
    nsec: int
    def __init__(self, sec: _Optional[int] = ..., nsec: _Optional[int] = ...) -> None: ...

class EgmPose(_message.Message):
    __slots__ = ("pos", "orient", "euler")
    POS_FIELD_NUMBER: _ClassVar[int]
    ORIENT_FIELD_NUMBER: _ClassVar[int]
    EULER_FIELD_NUMBER: _ClassVar[int]
    pos: EgmCartesian
    orient: EgmQuaternion
    euler: EgmEuler
    def __init__(self, pos: _Optional[_Union[EgmCartesian, _Mapping]] = ..., orient: _Optional[_Union[EgmQuaternion, _Mapping]] = ..., euler: _Optional[_Union[EgmEuler, _Mapping]] = ...) -> None: ...

class EgmCartesianSpeed(_message.Message):
    __slots__ = ("value",)
    VALUE_FIELD_NUMBER: _ClassVar[int]
    value: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, value: _Optional[_Iterable[float]] = ...) -> None: ...

class EgmJoints(_message.Message):
    __slots__ = ("joints",)
    JOINTS_FIELD_NUMBER: _ClassVar[int]
    joints: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, joints: _Optional[_Iterable[float]] = ...) -> None: ...

class EgmMotion(_message.Message):
    __slots__ = ("joints", "cartesian", "externalJoints", "time", "timeStamp")
    JOINTS_FIELD_NUMBER: _ClassVar[int]
    CARTESIAN_FIELD_NUMBER: _ClassVar[int]
    EXTERNALJOINTS_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    joints: EgmJoints
    cartesian: EgmPose
    externalJoints: EgmJoints
    time: EgmClock
    timeStamp: EgmTimestamp
    def __init__(self, joints: _Optional[_Union[EgmJoints, _Mapping]] = ..., cartesian: _Optional[_Union[EgmPose, _Mapping]] = ..., externalJoints: _Optional[_Union[EgmJoints, _Mapping]] = ..., time: _Optional[_Union[EgmClock, _Mapping]] = ..., timeStamp: _Optional[_Union[EgmTimestamp, _Mapping]] = ...) -> None: ...

class EgmSpeedRef(_message.Message):
    __slots__ = ("joints", "cartesians", "externalJoints")
    JOINTS_FIELD_NUMBER: _ClassVar[int]
    CARTESIANS_FIELD_NUMBER: _ClassVar[int]
    EXTERNALJOINTS_FIELD_NUMBER: _ClassVar[int]
    joints: EgmJoints
    cartesians: EgmCartesianSpeed
    externalJoints: EgmJoints
    def __init__(self, joints: _Optional[_Union[EgmJoints, _Mapping]] = ..., cartesians: _Optional[_Union[EgmCartesianSpeed, _Mapping]] = ..., externalJoints: _Optional[_Union[EgmJoints, _Mapping]] = ...) -> None: ...

class EgmPathCorr(_message.Message):
    __slots__ = ("pos", "age")
    POS_FIELD_NUMBER: _ClassVar[int]
    AGE_FIELD_NUMBER: _ClassVar[int]
    pos: EgmCartesian
    age: int
    def __init__(self, pos: _Optional[_Union[EgmCartesian, _Mapping]] = ..., age: _Optional[int] = ...) -> None: ...

class EgmState(_message.Message):
    __slots__ = ("state",)
    STATE_FIELD_NUMBER: _ClassVar[int]
    state: int
    def __init__(self, state: _Optional[int] = ...) -> None: ...

class EgmTestSignals(_message.Message):
    __slots__ = ("signals",)
    SIGNALS_FIELD_NUMBER: _ClassVar[int]
    signals: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, signals: _Optional[_Iterable[float]] = ...) -> None: ...

class EgmForceRw6(_message.Message):
    __slots__ = ("force",)
    FORCE_FIELD_NUMBER: _ClassVar[int]
    force: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, force: _Optional[_Iterable[float]] = ...) -> None: ...

class EgmForceRw7(_message.Message):
    __slots__ = ("fcActive", "force")
    FCACTIVE_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    fcActive: bool
    force: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, fcActive: bool = ..., force: _Optional[_Iterable[float]] = ...) -> None: ...

class EgmCollisionInfo(_message.Message):
    __slots__ = ("collsionTriggered", "collDetQuota")
    COLLSIONTRIGGERED_FIELD_NUMBER: _ClassVar[int]
    COLLDETQUOTA_FIELD_NUMBER: _ClassVar[int]
    collsionTriggered: bool
    collDetQuota: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, collsionTriggered: bool = ..., collDetQuota: _Optional[_Iterable[float]] = ...) -> None: ...

class EgmRapidData(_message.Message):
    __slots__ = ("digVal", "dnum")
    DIGVAL_FIELD_NUMBER: _ClassVar[int]
    DNUM_FIELD_NUMBER: _ClassVar[int]
    digVal: bool
    dnum: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, digVal: bool = ..., dnum: _Optional[_Iterable[float]] = ...) -> None: ...

class EgmRIState(_message.Message):
    __slots__ = ("jointVel", "torqueMeas", "torqueRefTotal", "torqueGravity", "motorCurrent", "jointPosRef", "jointVelRef", "tNs", "overruns", "armId", "mode", "order", "usedSeqno", "queueDepth")
    JOINTVEL_FIELD_NUMBER: _ClassVar[int]
    TORQUEMEAS_FIELD_NUMBER: _ClassVar[int]
    TORQUEREFTOTAL_FIELD_NUMBER: _ClassVar[int]
    TORQUEGRAVITY_FIELD_NUMBER: _ClassVar[int]
    MOTORCURRENT_FIELD_NUMBER: _ClassVar[int]
    JOINTPOSREF_FIELD_NUMBER: _ClassVar[int]
    JOINTVELREF_FIELD_NUMBER: _ClassVar[int]
    TNS_FIELD_NUMBER: _ClassVar[int]
    OVERRUNS_FIELD_NUMBER: _ClassVar[int]
    ARMID_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    USEDSEQNO_FIELD_NUMBER: _ClassVar[int]
    QUEUEDEPTH_FIELD_NUMBER: _ClassVar[int]
    jointVel: _containers.RepeatedScalarFieldContainer[float]
    torqueMeas: _containers.RepeatedScalarFieldContainer[float]
    torqueRefTotal: _containers.RepeatedScalarFieldContainer[float]
    torqueGravity: _containers.RepeatedScalarFieldContainer[float]
    motorCurrent: _containers.RepeatedScalarFieldContainer[float]
    jointPosRef: _containers.RepeatedScalarFieldContainer[float]
    jointVelRef: _containers.RepeatedScalarFieldContainer[float]
    tNs: int
    overruns: int
    armId: int
    mode: int
    order: int
    usedSeqno: int
    queueDepth: int
    def __init__(self, jointVel: _Optional[_Iterable[float]] = ..., torqueMeas: _Optional[_Iterable[float]] = ..., torqueRefTotal: _Optional[_Iterable[float]] = ..., torqueGravity: _Optional[_Iterable[float]] = ..., motorCurrent: _Optional[_Iterable[float]] = ..., jointPosRef: _Optional[_Iterable[float]] = ..., jointVelRef: _Optional[_Iterable[float]] = ..., tNs: _Optional[int] = ..., overruns: _Optional[int] = ..., armId: _Optional[int] = ..., mode: _Optional[int] = ..., order: _Optional[int] = ..., usedSeqno: _Optional[int] = ..., queueDepth: _Optional[int] = ...) -> None: ...

class EgmRIRef(_message.Message):
    __slots__ = ("torqueFF", "velRef", "posRef", "posGainScale", "velGainScale", "echoTNs", "echoSeqno", "validMask", "order")
    TORQUEFF_FIELD_NUMBER: _ClassVar[int]
    VELREF_FIELD_NUMBER: _ClassVar[int]
    POSREF_FIELD_NUMBER: _ClassVar[int]
    POSGAINSCALE_FIELD_NUMBER: _ClassVar[int]
    VELGAINSCALE_FIELD_NUMBER: _ClassVar[int]
    ECHOTNS_FIELD_NUMBER: _ClassVar[int]
    ECHOSEQNO_FIELD_NUMBER: _ClassVar[int]
    VALIDMASK_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    torqueFF: _containers.RepeatedScalarFieldContainer[float]
    velRef: _containers.RepeatedScalarFieldContainer[float]
    posRef: _containers.RepeatedScalarFieldContainer[float]
    posGainScale: _containers.RepeatedScalarFieldContainer[float]
    velGainScale: _containers.RepeatedScalarFieldContainer[float]
    echoTNs: int
    echoSeqno: int
    validMask: int
    order: int
    def __init__(self, torqueFF: _Optional[_Iterable[float]] = ..., velRef: _Optional[_Iterable[float]] = ..., posRef: _Optional[_Iterable[float]] = ..., posGainScale: _Optional[_Iterable[float]] = ..., velGainScale: _Optional[_Iterable[float]] = ..., echoTNs: _Optional[int] = ..., echoSeqno: _Optional[int] = ..., validMask: _Optional[int] = ..., order: _Optional[int] = ...) -> None: ...

class EgmRobot(_message.Message):
    __slots__ = ("header", "feedBack", "planned", "motorState", "mciState", "mciConvergenceMet", "testSignals", "rapidExecState", "measuredForce", "utilizationRate", "moveIndex", "collisionInfo", "rapidFromRobot", "torqueRef", "researchState")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_FIELD_NUMBER: _ClassVar[int]
    PLANNED_FIELD_NUMBER: _ClassVar[int]
    MOTORSTATE_FIELD_NUMBER: _ClassVar[int]
    MCISTATE_FIELD_NUMBER: _ClassVar[int]
    MCICONVERGENCEMET_FIELD_NUMBER: _ClassVar[int]
    TESTSIGNALS_FIELD_NUMBER: _ClassVar[int]
    RAPIDEXECSTATE_FIELD_NUMBER: _ClassVar[int]
    MEASUREDFORCE_FIELD_NUMBER: _ClassVar[int]
    UTILIZATIONRATE_FIELD_NUMBER: _ClassVar[int]
    MOVEINDEX_FIELD_NUMBER: _ClassVar[int]
    COLLISIONINFO_FIELD_NUMBER: _ClassVar[int]
    RAPIDFROMROBOT_FIELD_NUMBER: _ClassVar[int]
    TORQUEREF_FIELD_NUMBER: _ClassVar[int]
    RESEARCHSTATE_FIELD_NUMBER: _ClassVar[int]
    header: EgmHeader
    feedBack: EgmMotion
    planned: EgmMotion
    motorState: EgmState
    mciState: EgmState
    mciConvergenceMet: bool
    testSignals: EgmTestSignals
    rapidExecState: EgmState
    measuredForce: bytes
    utilizationRate: float
    moveIndex: int
    collisionInfo: EgmCollisionInfo
    rapidFromRobot: EgmRapidData
    torqueRef: EgmJoints
    researchState: EgmRIState
    def __init__(self, header: _Optional[_Union[EgmHeader, _Mapping]] = ..., feedBack: _Optional[_Union[EgmMotion, _Mapping]] = ..., planned: _Optional[_Union[EgmMotion, _Mapping]] = ..., motorState: _Optional[_Union[EgmState, _Mapping]] = ..., mciState: _Optional[_Union[EgmState, _Mapping]] = ..., mciConvergenceMet: bool = ..., testSignals: _Optional[_Union[EgmTestSignals, _Mapping]] = ..., rapidExecState: _Optional[_Union[EgmState, _Mapping]] = ..., measuredForce: _Optional[bytes] = ..., utilizationRate: _Optional[float] = ..., moveIndex: _Optional[int] = ..., collisionInfo: _Optional[_Union[EgmCollisionInfo, _Mapping]] = ..., rapidFromRobot: _Optional[_Union[EgmRapidData, _Mapping]] = ..., torqueRef: _Optional[_Union[EgmJoints, _Mapping]] = ..., researchState: _Optional[_Union[EgmRIState, _Mapping]] = ...) -> None: ...

class EgmSensor(_message.Message):
    __slots__ = ("header", "planned", "speedRef", "rapidToRobot", "researchRef")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    PLANNED_FIELD_NUMBER: _ClassVar[int]
    SPEEDREF_FIELD_NUMBER: _ClassVar[int]
    RAPIDTOROBOT_FIELD_NUMBER: _ClassVar[int]
    RESEARCHREF_FIELD_NUMBER: _ClassVar[int]
    header: EgmHeader
    planned: EgmMotion
    speedRef: EgmSpeedRef
    rapidToRobot: EgmRapidData
    researchRef: EgmRIRef
    def __init__(self, header: _Optional[_Union[EgmHeader, _Mapping]] = ..., planned: _Optional[_Union[EgmMotion, _Mapping]] = ..., speedRef: _Optional[_Union[EgmSpeedRef, _Mapping]] = ..., rapidToRobot: _Optional[_Union[EgmRapidData, _Mapping]] = ..., researchRef: _Optional[_Union[EgmRIRef, _Mapping]] = ...) -> None: ...

class EgmSensorPathCorr(_message.Message):
    __slots__ = ("header", "pathCorr")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    PATHCORR_FIELD_NUMBER: _ClassVar[int]
    header: EgmHeader
    pathCorr: EgmPathCorr
    def __init__(self, header: _Optional[_Union[EgmHeader, _Mapping]] = ..., pathCorr: _Optional[_Union[EgmPathCorr, _Mapping]] = ...) -> None: ...
