MODULE ArmlabStream
  ! Sends the arm position to a computer every 4 ms without moving the arm: for monitoring and for lead-through.
  ! armlab, MIT licence. Written from ABB's manual 3HAC073318-001 (Externally Guided Motion); not yet tested on a
  ! real controller. Replies from the computer are ignored.
  !
  ! For a YuMi, load this module into both tasks, with ROB_L and "armlab_l" in T_ROB_L, ROB_R and "armlab_r" in T_ROB_R.

  LOCAL VAR egmident guide;

  PROC main()
    EGMReset guide;
    EGMGetId guide;
    EGMSetupUC ROB_1, guide, "armlab", "armlab" \Joint;
    EGMStreamStart guide \SampleRate:=4;
    TPWrite "armlab: streaming";
    ! To lead the arm by hand, use the lead-through button or page of the pendant, or uncomment the next line.
    ! SetLeadThrough \On;
    WHILE TRUE DO
      WaitTime 0.5;
    ENDWHILE
  ENDPROC
ENDMODULE
