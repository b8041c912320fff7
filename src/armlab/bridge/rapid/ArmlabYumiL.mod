MODULE ArmlabYumiL
  ! Guides the left arm of a YuMi (task T_ROB_L) from a computer.
  ! armlab, MIT licence. Written from ABB's manual 3HAC073318-001 (Externally Guided Motion); not yet tested on a
  ! real controller. Start the program on the computer first; otherwise this module reports a time-out and retries.
  !
  ! Edit before the first run:
  !   tool0  your tool with its load: a wrong load causes event 41438 or wrong torques
  !   speed  maximum speed that guidance adds to the motion commanded by RAPID [degrees/s]
  !
  ! The seventh axis is eax_a here and \J7 below. RobotWare 6 examples have only \J1 to \J6. If the controller rejects
  ! \J7 when it loads the program, remove eax_a and \J7.

  LOCAL VAR jointtarget start;
  LOCAL CONST num speed := 90;
  LOCAL CONST num patience := 0.2;  ! s without a reply; until then, the last speed remains active
  LOCAL CONST egm_minmax never := [0, 0];  ! a window that is never met: guidance does not end when the arm is at rest
  LOCAL VAR egmident guide;

  PROC main()
    ! The first movement after a restart must not be guided, and guidance can begin only at a fine point. The target
    ! is the current position, so the arm does not move. To begin elsewhere, set start to a reachable posture.
    start := CJointT();
    MoveAbsJ start, v50, fine, tool0;
    WHILE TRUE DO
      EGMReset guide;
      EGMGetId guide;
      EGMSetupUC ROB_L, guide, "armlab", "armlab_l" \Joint \CommTimeout:=patience;
      EGMActJoint guide \StreamStart
        \J1:=never \J2:=never \J3:=never \J4:=never
        \J5:=never \J6:=never \J7:=never
        \LpFilter:=100 \SampleRate:=4 \MaxPosDeviation:=1000 \MaxSpeedDeviation:=speed;
      ! Returns after CondTime within the window, so it never returns. \PosCorrGain:=0 would follow only speeds.
      EGMRunJoint guide, EGM_STOP_HOLD \J1 \J2 \J3 \J4 \J5 \J6 \J7
        \CondTime:=3600 \RampInTime:=0.5 \PosCorrGain:=1;
      TPWrite "armlab: guidance ended and restarts";
    ENDWHILE
  ERROR
    IF ERRNO = ERR_UDPUC_COMM THEN
      TPWrite "armlab: no reply from the computer, waiting for it";
      WaitTime 1;
      TRYNEXT;
    ENDIF
    RAISE;
  ENDPROC
ENDMODULE
